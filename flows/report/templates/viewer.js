const viewer = document.querySelector("model-viewer");
const says = document.getElementById("viewer-says");
const note = says.textContent;
const form = document.querySelector("form.controls");
const field = id => document.getElementById(id);
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;

const bytesOf = id => Uint8Array.from(atob(field(id).textContent.trim()), c => c.charCodeAt(0));
const model = bytesOf("model");
const lights = {};
const lightOf = name => {
  // The viewer tells Radiance files by the end of their name.
  lights[name] ??= URL.createObjectURL(new Blob([bytesOf(`light-${name}`)])) + "#light.hdr";
  return lights[name];
};

const chosenLight = () => lightOf(form.elements.light.value);
const setLight = () => {
  viewer.environmentImage = chosenLight();
  viewer.skyboxImage = field("backdrop").checked ? chosenLight() : null;
};
const setExposure = () => {
  const stops = Number(field("exposure").value);
  viewer.exposure = 2 ** stops;
  const text = `${stops > 0 ? "+" : ""}${stops} stops`;
  form.querySelector("output[for=exposure]").textContent = text;
  field("exposure").setAttribute("aria-valuetext", text);
};

// -1 takes a value to 0, 0 leaves it as it was found, 1 takes it to 1.
const moved = (value, by) => (by < 0 ? value * (1 + by) : value + (1 - value) * by);
const linear = byte => {
  const x = byte / 255;
  return x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
};

/** Pictures of the file's roughness and metallic, by material, to be painted anew. */
const readPictures = async () => {
  const header = new DataView(model.buffer, model.byteOffset);
  const length = header.getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(model.subarray(20, 20 + length)));
  const binary = model.subarray(28 + length);
  return Promise.all((json.materials ?? []).map(async material => {
    const texture = material.pbrMetallicRoughness?.metallicRoughnessTexture;
    if (!texture) return null;
    const image = json.images[json.textures[texture.index].source];
    const view = json.bufferViews[image.bufferView];
    const start = view.byteOffset ?? 0;
    const blob = new Blob([binary.subarray(start, start + view.byteLength)], { type: image.mimeType });
    const picture = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none", imageOrientation: "flipY" });
    const canvas = new OffscreenCanvas(picture.width, picture.height);
    const pen = canvas.getContext("2d");
    pen.drawImage(picture, 0, 0);
    return pen.getImageData(0, 0, picture.width, picture.height);
  }));
};

const setup = async () => {
  const found = viewer.model.materials.map(({ pbrMetallicRoughness: pbr }) => ({
    pbr, color: [...pbr.baseColorFactor], roughness: pbr.roughnessFactor, metallic: pbr.metallicFactor,
    texture: pbr.metallicRoughnessTexture.texture, painted: null,
  }));
  let pictures = null;

  const paint = (entry, picture, by) => {
    entry.painted ??= viewer.createCanvasTexture();
    const canvas = entry.painted.source.element;
    canvas.width = picture.width;
    canvas.height = picture.height;
    const table = (factor, amount) =>
      Uint8ClampedArray.from({ length: 256 }, (_, i) => Math.round(255 * moved((i / 255) * factor, amount)));
    const green = table(entry.roughness, by.roughness), blue = table(entry.metallic, by.metallic);
    const data = new Uint8ClampedArray(picture.data);
    for (let i = 0; i < data.length; i += 4) {
      data[i + 1] = green[data[i + 1]];
      data[i + 2] = blue[data[i + 2]];
    }
    canvas.getContext("2d").putImageData(new ImageData(data, picture.width), 0, 0);
    entry.painted.source.update();
    entry.pbr.metallicRoughnessTexture.setTexture(entry.painted);
    entry.pbr.setRoughnessFactor(1);
    entry.pbr.setMetallicFactor(1);
  };

  const setMaterials = async () => {
    const by = { roughness: Number(field("roughness").value), metallic: Number(field("metallic").value) };
    const tint = field("tint").value.match(/[0-9a-f]{2}/gi).map(part => linear(parseInt(part, 16)));
    for (const [name, amount] of Object.entries(by)) {
      const text = amount === 0 ? "as found" : `${amount < 0 ? "less" : "more"}, ${Math.round(100 * Math.abs(amount))} %`;
      form.querySelector(`output[for=${name}]`).textContent = text;
      field(name).setAttribute("aria-valuetext", text);
    }
    const isAsFound = by.roughness === 0 && by.metallic === 0;
    if (!isAsFound) pictures ??= await readPictures();
    found.forEach((entry, index) => {
      entry.pbr.setBaseColorFactor([...entry.color.slice(0, 3).map((c, i) => c * tint[i]), entry.color[3]]);
      const picture = pictures?.[index];
      if (isAsFound || !picture) {
        if (entry.painted) entry.pbr.metallicRoughnessTexture.setTexture(entry.texture);
        entry.pbr.setRoughnessFactor(moved(entry.roughness, by.roughness));
        entry.pbr.setMetallicFactor(moved(entry.metallic, by.metallic));
      } else {
        paint(entry, picture, by);
      }
    });
  };

  let waiting = false;
  const soon = () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(async () => { waiting = false; await setMaterials(); });
  };
  for (const id of ["roughness", "metallic", "tint"]) field(id).addEventListener("input", soon);
  form.addEventListener("reset", () => setTimeout(() => { setLight(); setExposure(); soon(); }));
};

const turn = isTurning => {
  viewer.autoRotate = isTurning;
  field("turn").setAttribute("aria-pressed", String(isTurning));
};

if (document.createElement("canvas").getContext("webgl2") === null) {
  form.hidden = true;
  says.textContent = "This browser draws no WebGL 2: here is a picture. Open asset.glb in any glTF viewer.";
} else {
  setLight();
  for (const light of form.elements.light) light.addEventListener("change", setLight);
  field("backdrop").addEventListener("change", setLight);
  field("exposure").addEventListener("input", setExposure);
  field("turn").addEventListener("click", () => turn(!viewer.autoRotate));
  viewer.addEventListener("load", () => { says.textContent = note; setup(); }, { once: true });
  viewer.addEventListener("error", () => { says.textContent = "The asset cannot be shown here; open asset.glb."; });
  const look = field("look");
  look?.addEventListener("click", () => {
    const view = about.views[Number(field("view").value)];
    turn(false);
    viewer.resetTurntableRotation(0);
    viewer.cameraOrbit = `${view.azimuth_deg}deg ${90 - view.elevation_deg}deg ${view.distance}m`;
    if (calm) viewer.jumpCameraToGoal();
    document.getElementById("asset").scrollIntoView();
    viewer.focus();
  });
  turn(!calm);
  viewer.src = URL.createObjectURL(new Blob([model], { type: "model/gltf-binary" }));
}

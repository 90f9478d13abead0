// Without this script the sheets are shown whole.
const about = JSON.parse(document.getElementById("about").textContent);
document.documentElement.classList.add("live");

const scrub = document.getElementById("scrub");
if (scrub) {
  const slider = document.getElementById("view");
  const said = scrub.querySelector("output[for=view]");
  const tiles = [...scrub.querySelectorAll(".tile")];
  const rows = Math.ceil(about.views.length / about.columns);
  const show = () => {
    const place = Number(slider.value);
    const channel = scrub.querySelector("input[name=channel]:checked").value;
    const view = about.views[place];
    const label = `view ${view.view}, ${Math.round(view.azimuth_deg)}° around, ${Math.round(view.elevation_deg)}° up`;
    said.textContent = label;
    slider.setAttribute("aria-valuetext", label);
    for (const tile of tiles) {
      tile.setAttribute("role", "img");
      const has = tile.querySelector(`img[data-channel="${channel}"]`);
      const kind = tile.dataset.kind === "views" ? "The view" : "The asset";
      tile.setAttribute("aria-label", has ? `${kind}: ${channel}, ${label}` : `${kind} has no ${channel}`);
      for (const picture of tile.querySelectorAll("img")) {
        picture.hidden = picture !== has;
        picture.alt = "";
      }
      if (!has) continue;
      has.style.width = `${100 * about.columns}%`;
      has.style.height = `${100 * rows}%`;
      has.style.left = `${-100 * (place % about.columns)}%`;
      has.style.top = `${-100 * Math.floor(place / about.columns)}%`;
    }
  };
  slider.addEventListener("input", show);
  scrub.addEventListener("change", show);
  // Dragging over a picture turns it too.
  for (const tile of tiles) {
    tile.addEventListener("pointermove", event => {
      if (event.buttons !== 1 && event.pointerType === "mouse") return;
      const box = tile.getBoundingClientRect();
      const share = Math.min(0.999, Math.max(0, (event.clientX - box.left) / box.width));
      slider.value = String(Math.floor(share * about.views.length));
      show();
    });
    tile.style.touchAction = "pan-y";
  }
  show();
}

"""States of the networks that LPIPS compares by, with weights that a formula gives."""

import torch

CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
PLACES = {  # of convolutions in the packages' slices
    "alex": ((0,), (3,), (6,), (8,), (10,)),
    "vgg": ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)),
    "shift tolerant": ((0,), (5,), (9,), (11,), (13,)),
}
BLURS = {"1.1": 64, "2.4": 64, "3.8": 192}
SIDES = {"alex": (11, 5, 3, 3, 3), "vgg": (3,) * 5}


def formula_weights(state):
    """The same numbers wherever: waves of another length for each tensor."""
    made = {}
    for place, (name, value) in enumerate(sorted(state.items())):
        wave = torch.sin(torch.arange(value.numel()).double() * (0.7 + 0.1 * place) + place)
        if name.startswith("lin"):
            wave = 0.5 + 0.5 * wave
        elif value.dim() == 4:
            wave = wave * (6.0 / value[0].numel()) ** 0.5
        else:
            wave = 0.1 * wave
        kept = "scaling" in name or name.endswith("filt")
        made[name] = value if kept else wave.view(value.shape).float()
    return made


def blank_state(net, kind):
    """Names and shapes of a package's state."""
    before, state = 3, {}
    for level, places in enumerate(PLACES[kind]):
        width, side = CHANNELS[net][level], SIDES[net][level]
        for place in places:
            stem = f"net.slice{level + 1}.{place}"
            state[f"{stem}.weight"] = torch.zeros(width, before, side, side)
            state[f"{stem}.bias"] = torch.zeros(width)
            before = width
        state[f"lin{level}.model.1.weight"] = torch.zeros(1, width, 1, 1)
    if kind == "shift tolerant":
        blurs = {f"net.slice{where}.filt": torch.zeros(c, 1, 3, 3) for where, c in BLURS.items()}
        state |= blurs
    state |= {"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}
    return state | {"scaling_layer.scale": torch.ones(1, 3, 1, 1)}

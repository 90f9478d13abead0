"""The generator: a video diffusion model of colour and materials.

Everything here is channel first, `[batch, frames, channels, height, width]`, as networks want it;
`svim3d.diffusion.groups` is the door to the channel-last pictures of the rest of the library.
"""

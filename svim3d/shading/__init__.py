"""Light and reflectance: microfacet model, environment maps, split-sum shading, tone mapping."""

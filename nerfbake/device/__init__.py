"""Graphics cards: the adapters of this machine, and a device that runs compute shaders in WGSL."""

"""Networks of radiance fields: perceptrons, hash grids, planes, and the encodings of positions and directions."""

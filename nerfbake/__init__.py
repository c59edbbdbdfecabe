"""nerfbake converts trained radiance fields into files for game engines, DCC tools, web pages and shaders.

    from nerfbake import load, save, build_octree

    octree = build_octree(load("chair.npz"), resolution=128)
    save("chair.svo.pb", octree)

__init__.pyi lists the public names. Each is imported on first use, so that `import nerfbake` stays fast.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

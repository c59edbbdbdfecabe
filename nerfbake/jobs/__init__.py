"""Jobs: the commands as functions from files to files, for Python, for batches and for the command line.

    from nerfbake.jobs import Budget, ViewSelection, bake_octree, render_views

    bake_octree("chair.npz", "chair.svo.pb", resolution=128, budget=Budget(min_psnr=30))
    render_views("chair.svo.pb", "turn.gif", ViewSelection(turntable=36, size=(400, 400)))

A job checks its arguments before it does any work. It writes a file completely or not at all. Errors are NerfbakeError,
with the exit code of the command. A job prints nothing unless you pass `steps`, and stays within the memory_limit()
around it. The public names are listed in __init__.pyi and imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

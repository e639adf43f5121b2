"""Range imaging and visual servoing in OpenCL.

Describe an operation once, then call it::

    import gpuvision as gv

    readout = gv.PsdReadout(strip_length=6e-3)
    reading = readout(currents)  # NumPy in, NumPy out

or bind it to a device and a shape for the hot path, or stream frames through it with a `Pipeline`.
"""

import os

import lazy_loader

__version__ = "0.2.0"  # the only place: the wheel, the command and the documentation read it here

# In a checkout the packages `host`, `kernels` and `profiling` are siblings of this folder, and `reference` is in
# `tests`; in a wheel they are inside this folder. Extending the search path makes `import gpuvision.host` work when
# Python starts in the repository's root.
if not os.path.isdir(os.path.join(__path__[0], "host")):
    _root = os.path.dirname(__path__[0])
    __path__.extend((_root, os.path.join(_root, "tests")))

# A name is imported at its first use: the command starts at once. The stub `__init__.pyi` lists the names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Find things in 3D Gaussian scenes by text, at the level of points, in functional JAX on a plain CPU.

The stub __init__.pyi lists the public names. lazy_loader imports the module of a name when the name is first used, so
`import jsecon` does not start jax.
"""

import lazy_loader

__version__ = "0.3.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""Tools for tests, ours and yours: a toy scenario whose runs take seconds, and contract checks.

Importing this package registers the toy as `clbench/Toy-v0`; "clbench.testing:clbench/Toy-v0" names it in a
command.
"""

import lazy_loader

from clbench.spec.registry import register

# `__init__.pyi` names the module of each name. A process that draws pictures imports no PyTorch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register("clbench/Toy-v0", "clbench.testing:TOY")

"""For tests, ours and yours: a toy scenario on which a run takes seconds, and contract checks.

Importing this package registers the toy as `clbench/Toy-v0`; "clbench.testing:clbench/Toy-v0" names it in a
command.
"""

import lazy_loader

from clbench.spec.registry import register

# `__init__.pyi` says where each name is defined. A process that draws pictures imports no PyTorch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register("clbench/Toy-v0", "clbench.testing:TOY")

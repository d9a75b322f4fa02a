"""Commands that are longer than a screen; `clbench.cli` names them."""

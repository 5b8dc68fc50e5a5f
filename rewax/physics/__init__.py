"""Solvers side by side on shared ground: ``mpm``, ``tets``, ``rigid``; ``coupling`` knows more than one of them."""

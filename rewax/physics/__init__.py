"""Physics: the solvers ``mpm``, ``tets`` and ``rigid``, and ``coupling`` between them."""

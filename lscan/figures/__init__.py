"""How figures of reports look, and the grids that surfaces are drawn from.

Importing this package loads no plotting library; ``style`` does.
"""

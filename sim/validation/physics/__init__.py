"""The tank's evidence: every effect against a closed form, a known value or another renderer.

``run_verify`` measures all chapters there and then and writes the figures and a page that shows
them.  A chapter is one module with one function that returns a :class:`~sim.validation.rows.Topic`;
it joins by its line in ``sim.validation.physics.chapters``.
"""

"""The ``djet lab`` command: one module per verb."""

"""The ``djet`` command: one module per subcommand."""

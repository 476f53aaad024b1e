"""The parameter schema: sections, flat names, YAML files and command-line flags."""

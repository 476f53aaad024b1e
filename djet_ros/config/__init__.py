"""One schema of parameters: sections, flat names, YAML files and flags."""

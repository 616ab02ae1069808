"""Chips that come with the package, one YAML file each."""

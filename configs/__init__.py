"""The presets that ship with the package; ``switchmt-snn train NAME`` finds them by name."""

"""Hardware targets: one YAML file per chip and source (see :mod:`switchmt_snn.export.energy.estimate`)."""

"""Hardware targets: one YAML file per chip and source (see ``switchmt_snn.export.energy.estimate``)."""

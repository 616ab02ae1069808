"""Charts and pages without a plotting library: one layout, drawn as SVG and as PNG. It knows nothing of runs."""

"""The profile's report page."""

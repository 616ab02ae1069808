"""The C++ engine of the model. Delete this folder and everything else works without it."""

"""What Sphinx needs beyond its own extensions to build this documentation."""

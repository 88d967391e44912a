"""The report of `vcal loop`: page, pictures, record and writer, and a file for an own effect."""

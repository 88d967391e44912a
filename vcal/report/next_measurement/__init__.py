"""The report of `vcal design --next`: page, pictures, record and writer."""

"""What every page shares: the sheet, its style, pictures, provenance, the folder written."""

"""The report of a closed loop: page, pictures, record, tables, and the file for an own effect."""

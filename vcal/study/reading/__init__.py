"""Reading of any table: text, spreadsheet or parquet, with a mapping of its columns.

`formats` declares the keys that say how a file is read; `text`, `workbook` and `parquet` read a
file into a `grid` of cells; `units` and `times` convert cells; `assign` decides which column of the
file holds which quantity.
"""

"""The result of closing the loop: `closure` (verdict, effects, errors) and `unexplained` (what no
effect describes).

Numbers and names only; pages, files and pictures are made from them elsewhere. Knows `residuals`,
`weighing` and what is below. `search`, `notes` and `close_loop` stand on it, and the report reads
it.
"""

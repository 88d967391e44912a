"""The history of a machine over several reports."""

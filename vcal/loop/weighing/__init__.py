"""Weighing: candidates refitted, compared by evidence and by readings that were held out."""

"""Pictures of the results: functions that return a matplotlib figure."""

from lazy_loader import attach_stub

# Named in `__init__.pyi`, and imported where it is used: pictures need matplotlib, which takes as
# long to import as a small command takes to run.
__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)

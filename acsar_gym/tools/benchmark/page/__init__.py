"""The HTML report of a benchmark: tables, plots, and its worst episodes as videos."""

from acsar_gym.tools.benchmark.page.report import page, write

__all__ = ["page", "write"]

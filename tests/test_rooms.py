"""No files import each other in a circle."""

from __future__ import annotations

from graphlib import TopologicalSorter

import grimp


def test_imports_have_no_circles() -> None:
    graph = grimp.build_graph("acsar_gym", exclude_type_checking_imports=True)
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    assert len(imports) > 100
    TopologicalSorter(imports).prepare()  # which raises CycleError

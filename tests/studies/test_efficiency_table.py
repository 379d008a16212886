"""The table that compares samplers."""

import io

from rich.cells import cell_len
from rich.console import Console

from studies.compare_samplers.efficiency import Efficiency
from studies.compare_samplers.table import HEADER, Setting, efficiency_table
from studies.terminal import in_terminal

SETTING = Setting("a phantom", 4, 5.0, "R̂ below 1.01 and ESS above 400")
FOUND = [
    Efficiency("slow", True, "", 100, 1.8, 4.0, 6.0, 0.01, 0.008, 1e-5, 0, 400_000, 0.2, 1.0, 400.0, 500.0, None),
    Efficiency("fast", True, "", 900, 1.004, 500.0, 450.0, 9.0, 3.0, 0.05, 9000, 0, 0.8, 90.0, 50.0, 150.0, 150.0),
    Efficiency("rough", False, "", 900, 1.0, 900.0, 880.0, 88.0, 8.0, None, 0, 0, 1.0, 90.0, 10.0, 110.0, 110.0),
    Efficiency("other", note="it has no step for t_similarity"),
]


def test_rows_are_ranked_and_approximate_ones_apart():
    (_, exact), (title, approximate) = efficiency_table(FOUND, SETTING).groups
    assert [row[0] for row in exact] == ["fast", "slow", "other"]
    assert (title, approximate[0][0]) == ("Approximate", "rough")
    assert all(len(row) == len(HEADER) for row in exact + approximate)
    assert exact[0][HEADER.index("Rule met, s")] == "150"
    assert exact[1][HEADER.index("Rule met, s")] == "–"
    assert exact[1][HEADER.index("Worst R̂")] == "1.800"


def test_the_terminal_shows_what_matters():
    shown = Console(width=80, record=True, file=io.StringIO())
    shown.print(in_terminal(efficiency_table(FOUND, SETTING)))
    lines = shown.export_text().splitlines()
    assert max(map(cell_len, lines)) <= 80
    (fast,) = (line for line in lines if "fast" in line)
    assert [cell.strip() for cell in fast.split("│")[1:-1]] == ["fast", "9.00", "3.00", "50.0", "1.004", "150", "150"]
    assert any("rough" in line for line in lines)

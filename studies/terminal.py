"""The tables of studies, shown on a terminal."""

from __future__ import annotations

from rich.table import Table as TerminalTable

from bayesreg.report.tables import Table


def in_terminal(table: Table) -> TerminalTable:
    """Format a table for a terminal, without its caption."""
    terminal_table = TerminalTable(title=table.title)
    for index, name in enumerate(table.header):
        terminal_table.add_column(name, justify="right" if index else "left")
    for _, rows in table.groups:
        for row in rows:
            terminal_table.add_row(*row)
    return terminal_table

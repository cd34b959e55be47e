"""What GNU Radio Companion shows of each of our blocks, as JSON: for a test that starts it where GRC runs.

Of every block: ``hover``, the text over its name in the tree of blocks; ``page``, the page Documentation of its
dialog; ``labels`` and ``hovers``, the labels of its settings and the texts over their fields; ``errors``.
"""

from __future__ import annotations

import json
from typing import Any

import gi


def inside(widget: Any) -> list[Any]:
    """A widget, and everything in it."""
    from gi.repository import Gtk

    found = [widget]
    if isinstance(widget, Gtk.Container):
        for child in widget.get_children():
            found += inside(child)
    return found


def only(widgets: list[Any], kind: type[Any]) -> list[Any]:
    return [widget for widget in widgets if isinstance(widget, kind)]


def texts(window: Any, flow_graph: Any, key: str) -> dict[str, Any]:
    from gi.repository import Gtk
    from gnuradio.grc.gui.PropsDialog import PropsDialog

    block = flow_graph.new_block(key)
    dialog = PropsDialog(window, block)
    pages = {}
    for page in range(dialog.notebook.get_n_pages()):
        child = dialog.notebook.get_nth_page(page)
        pages[dialog.notebook.get_tab_label(child).get_text()] = inside(child)
    (buffer,) = (view.get_buffer() for view in only(pages.pop("Documentation"), Gtk.TextView))
    fields = [widget for page in pages.values() for widget in page]
    said = {
        "page": buffer.get_text(buffer.get_start_iter(), buffer.get_end_iter(), include_hidden_chars=False),
        "labels": [label.get_text() for label in only(fields, Gtk.Label)],
        "hovers": [text for widget in fields if (text := widget.get_tooltip_text())],
        "errors": list(block.get_error_messages()),
    }
    dialog.destroy()
    return said


def show(application: Any) -> None:
    from gnuradio.grc.gui.BlockTreeWindow import KEY_INDEX

    window, tree = application.main_window, application.main_window.btwin
    column, found = tree.treeview.get_tooltip_column(), {}
    flow_graph = window.current_page.flow_graph

    def look(rows: Any, _path: object, row: Any) -> None:
        key = rows.get_value(row, KEY_INDEX)
        if key.startswith("ros2_"):
            found[key] = {"hover": rows.get_value(row, column)}

    tree.treestore.foreach(look)
    for key in found:
        found[key] |= texts(window, flow_graph, key)
    print(json.dumps(found))
    application.quit()


def library() -> Any:
    """The blocks. To be called before anything of GRC's window is imported."""
    from gnuradio import gr
    from gnuradio.grc.gui.Platform import Platform

    versions = gr.major_version(), gr.api_version(), gr.minor_version()
    platform = Platform(version=gr.version(), version_parts=versions, prefs=gr.prefs(), install_prefix=gr.prefix())
    platform.build_library()
    return platform


def main() -> None:
    gi.require_version("Gtk", "3.0")
    gi.require_version("PangoCairo", "1.0")
    platform = library()
    from gnuradio.grc.gui.Application import Application

    application = Application([], platform)
    application.connect_after("activate", show)
    application.run()


if __name__ == "__main__":
    main()

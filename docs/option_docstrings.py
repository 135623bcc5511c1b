"""Extension of mkdocstrings: docstrings of options classes, which exist only at run time."""

import griffe


class OptionDocstrings(griffe.Extension):
    """Replaces the docstrings in the source with those of the imported classes."""

    def on_class(self, *, cls: griffe.Class, **_: object) -> None:
        """Replace the docstring of an options class."""
        if cls.docstring is not None and cls.path.startswith("colmap_av1.options."):
            cls.docstring.value = griffe.dynamic_import(cls.path).__doc__

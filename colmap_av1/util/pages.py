"""HTML pages from the templates of this package, which need no other files and no network."""

from __future__ import annotations


def render_page(template: str, **values: object) -> str:
    """Fill in a template; all text is escaped.

    Args:
        template: name of a file in `templates/`.
        values: variables of the template.
    """
    import jinja2  # noqa: PLC0415 - few commands write pages

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("colmap_av1"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)

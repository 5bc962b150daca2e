"""Pictures: hillshades of several surfaces under one light, all maps of one surface, and a page to turn it in 3-D.

They return figure objects, made without pyplot, so nothing global changes and no display is needed:
`compare_heights(...).savefig("surfaces.png")`, `surface_preview(...).savefig("preview.png")`,
`Path("surfaces.html").write_text(page_html(surface_page(...)))`. Needs `pip install 'torchdls[plots]'`.
"""

from torchdls.plot.comparison import compare_heights
from torchdls.plot.page import page_html, surface_page
from torchdls.plot.preview import png_bytes, surface_preview
from torchdls.plot.relief import hillshade

__all__ = ["compare_heights", "hillshade", "page_html", "png_bytes", "surface_page", "surface_preview"]

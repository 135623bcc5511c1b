"""Draw motion and tracks over frames, matches and models; write pages of models."""

from colmap_av1.view.matches import view_database
from colmap_av1.view.model import serve_model, view_model
from colmap_av1.view.page import write_model_page
from colmap_av1.view.pictures import write_picture
from colmap_av1.view.video import view_video

__all__ = [
    "serve_model",
    "view_database",
    "view_model",
    "view_video",
    "write_model_page",
    "write_picture",
]

"""One page about many models: pictures and figures, to sort and to filter."""

from viz.gallery.page import write_gallery as write_gallery

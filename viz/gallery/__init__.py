"""One page about many models: pictures and figures, to sort and to filter."""

from modeler.viz.gallery.page import write_gallery as write_gallery

"""A run as one page that opens anywhere: no network, no viewer to install."""

from modeler.viz.report.page import write_page as write_page

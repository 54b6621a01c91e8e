"""Views: segmented frames as registration uses them, and the noise of their depth."""

from modeler.views.rays import Sensor as Sensor

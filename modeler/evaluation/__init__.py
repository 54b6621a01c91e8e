"""Pure metrics: errors of estimates and models, and calibration of their covariances."""

from modeler.evaluation.poses import LEVELS as LEVELS
from modeler.evaluation.poses import about_point as about_point
from modeler.evaluation.poses import align_to_model as align_to_model
from modeler.evaluation.poses import coverage as coverage
from modeler.evaluation.poses import nees as nees
from modeler.evaluation.poses import rotation_error_deg as rotation_error_deg
from modeler.evaluation.poses import trajectory_errors as trajectory_errors
from modeler.evaluation.poses import translation_error_m as translation_error_m
from modeler.evaluation.poses import true_motion as true_motion
from modeler.evaluation.surfaces import SurfaceErrors as SurfaceErrors
from modeler.evaluation.surfaces import TrueSurface as TrueSurface
from modeler.evaluation.surfaces import sample_surface as sample_surface
from modeler.evaluation.surfaces import surface_errors as surface_errors

"""A sink: what a run leaves on disk, whole at any moment."""

from modeler.export.files import alone as alone
from modeler.export.files import write_atomically as write_atomically
from modeler.export.formats import g2o_text as g2o_text
from modeler.export.formats import ply_bytes as ply_bytes
from modeler.export.formats import tum_text as tum_text
from modeler.export.mesh import files_of as files_of
from modeler.export.mesh import format_of as format_of
from modeler.export.mesh import mesh_of as mesh_of
from modeler.export.mesh import simplified as simplified
from modeler.export.mesh import tinted as tinted
from modeler.export.mesh import write_bop as write_bop
from modeler.export.mesh import write_mesh as write_mesh
from modeler.export.pairs import Pairs as Pairs
from modeler.export.pairs import Remembered as Remembered
from modeler.export.reading import edges_of as edges_of
from modeler.export.reading import poses_of as poses_of
from modeler.export.reading import read_model as read_model
from modeler.export.report import RunMeta as RunMeta
from modeler.export.report import edge_record as edge_record
from modeler.export.report import report_of as report_of
from modeler.export.run_folder import RunFolder as RunFolder
from modeler.export.standing import model_upright as model_upright
from modeler.export.texture import textured as textured

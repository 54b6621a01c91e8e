"""Whether the model of a run can be trusted, and why not."""

from modeler.verdict.evidence import Figure as Figure
from modeler.verdict.judgement import FrameRecord as FrameRecord
from modeler.verdict.judgement import Shortcoming as Shortcoming
from modeler.verdict.judgement import Verdict as Verdict
from modeler.verdict.judgement import judged as judged

"""Whether the model of a run can be trusted, and why not."""

from modeler.verdict.judgement import judged as judged

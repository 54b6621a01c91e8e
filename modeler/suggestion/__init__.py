"""What to do next: the most informative view, turn or poke (docs/method/suggestion.md)."""

from modeler.suggestion.belief import Belief as Belief
from modeler.suggestion.belief import Prediction as Prediction
from modeler.suggestion.candidates import Candidate as Candidate
from modeler.suggestion.edge_prediction import EdgePredictor as EdgePredictor
from modeler.suggestion.ranking import Goal as Goal
from modeler.suggestion.ranking import Suggestion as Suggestion
from modeler.suggestion.ranking import Suggestions as Suggestions
from modeler.suggestion.ranking import suggest as suggest

"""What to do next: the view, turn or poke that tells most (docs/method.md, "What to do next")."""

from modeler.suggestion.belief import Belief as Belief
from modeler.suggestion.belief import Prediction as Prediction
from modeler.suggestion.candidates import Candidate as Candidate
from modeler.suggestion.edge_forecast import EdgeForecast as EdgeForecast
from modeler.suggestion.ranking import Goal as Goal
from modeler.suggestion.ranking import Suggestion as Suggestion
from modeler.suggestion.ranking import Suggestions as Suggestions
from modeler.suggestion.ranking import suggest as suggest

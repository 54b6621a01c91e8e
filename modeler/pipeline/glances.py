"""A cheap look at a pair, by which frames that nothing placed so far are told from those worth a search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modeler.registration import VisibilityRegistrar
from modeler.types import AbstractRegistrar

_SHARE = 0.25  # of the places from which a search starts, and of the samples that it draws at most


def glancing(registrar: AbstractRegistrar) -> AbstractRegistrar | None:
    """Return a registrar that gives up a hopeless pair at a small part of the cost; None where its method has none.

    Views without common surface cost most of all: the search climbs everywhere, and every place that it finds is
    sampled again and again. A glance follows the best place alone, and once.
    """
    if not isinstance(registrar, VisibilityRegistrar):
        return None
    search = registrar.search
    search = replace(
        search,
        max_starts=int(_SHARE * search.max_starts),
        starts_per_basin=_SHARE * search.starts_per_basin,
        low_overlap_score=-np.inf,
    )
    sampler = replace(registrar.sampler, max_draws=int(_SHARE * registrar.sampler.max_draws))
    return replace(registrar, search=search, sampler=sampler, max_modes=1, max_rounds=1)

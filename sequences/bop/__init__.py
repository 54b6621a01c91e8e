"""Scene folders of the BOP benchmark, read and written."""

from sequences.bop.sequence import BopSequence as BopSequence
from sequences.bop.writer import write_bop as write_bop

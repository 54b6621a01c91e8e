"""What colour tells: aligned and displaced, on bodies of natural texture and on captures."""

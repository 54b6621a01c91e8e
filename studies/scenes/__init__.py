"""Whether the object is found in scenes of all kinds without masks, and whether hands before it do harm."""

"""The study of views far apart: what is found from scratch, and how often answers that are stood by are right."""

"""The page in the browser: from a capture to a checked model without typing.

It has no method of its own: it shows what the library finds, and starts the commands whose lines it shows.
"""

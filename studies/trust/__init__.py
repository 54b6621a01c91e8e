"""Whether exit status 0 is a promise: sound runs and runs with one fault each, judged against the truth."""

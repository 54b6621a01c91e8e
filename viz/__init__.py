"""Visualisation of runs: the only package that imports Rerun."""

import os

# Rerun logs a closed viewer, which is no error, a full disk, and that a recording has no list of its pieces; we report
# what matters.
os.environ.setdefault("RUST_LOG", "warn,re_sdk=off,re_grpc_client=off,re_log_encoding=off")

"""The command line and a run: options, stages, pipeline, answers, reports."""

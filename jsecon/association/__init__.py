"""One identity for each object in all views: proposals of frames brought together."""

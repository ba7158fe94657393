"""The ruler: a scene bundle and the truth in, the metrics of CONTRACT section 4 out, per stage where that is kept."""

"""Adaptation: the graph that bends a demonstration into what a robot can do (docs/adaptation.md)."""

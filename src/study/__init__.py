"""Thoracic cartilage ultrasound-CT registration with a dense skeleton graph, as a reproducible study."""

__version__ = "0.1.0"

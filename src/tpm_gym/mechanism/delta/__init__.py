"""Clavel's Delta: three rotary arms at 120 degrees, each with a parallelogram of ball joints."""

"""The pure core of a map: events in, effects out; no bus, no clock, no thread, no solver."""

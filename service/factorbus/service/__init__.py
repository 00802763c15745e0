"""The process that owns maps: a pure state machine per map, and one thin shell that puts it on the bus.

app        the shell: the only file here that knows Zenoh
core       one map: events in, effects out
admission  who may insert what next: sequence numbers, the bounded inbox, fairness
apply      waiting inserts into the solver, one step, the delta: what the solver thread runs
questions  what may be asked, and answers made from a copy of what they need
reads      questions that wait, and which of them go to the solver together
dispatch   jobs for workers: who gets which, until when, and who next
registry   the maps there are
config     limits and endpoints
"""

"""What a map has been through, on disk: every insert in the order the solver saw it, now and then the solver itself.

folder of a service/          one service owns it (`lock`)
  MAP/
    journal.db                every insert and what became of it (`store`, SQLite)
    checkpoint-N.fbs            the solver's state after record N (`checkpoints`)
"""

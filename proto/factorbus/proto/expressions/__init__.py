"""Residuals as expressions: what a factor kind of one's own is made of, as data that is sent, checked and computed."""

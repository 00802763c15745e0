"""The command line: `factorbus demo`, `serve`, `work`, `replay` and the others.

main       the table of commands and the exit of the process; imports nothing heavy
exits      exit codes, and which error leads to which
screen     progress to standard error, the result to standard output
children   other processes of ours, started and never left behind
drive      a stream of inserts into a map, measured, on the bus or in this process
<command>  one file per command, imported when it is called
"""

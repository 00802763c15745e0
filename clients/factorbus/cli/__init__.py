"""The command line: `factorbus demo`, `serve`, `work`, `replay` and the others.

entry      the console script: what is interrupted before all is imported ends as any command does
main       the table of commands and the exit of the process; imports nothing heavy
output/    what is printed, exit codes, and which error leads to which
process/   options that commands share, the connection to the bus, children that are never left behind
driving/   a stream of inserts into a map, measured, on the bus or in this process
commands/  one file per command, imported when it is called
"""

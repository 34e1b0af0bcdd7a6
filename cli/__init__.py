"""The command line: one file a command, no logic; everything heavy is imported when a command runs."""

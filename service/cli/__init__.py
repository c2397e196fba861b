"""The command line: prompts, prints and exits; no other room does, but programs that it starts and reads."""

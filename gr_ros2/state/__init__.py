"""Files that a robot keeps from one start to the next: keys, boot numbers, what it has heard."""

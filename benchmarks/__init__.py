"""Speed, memory and accuracy, printed as tables."""

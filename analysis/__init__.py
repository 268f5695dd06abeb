"""What analyze.py and evaluate.py read and compute with."""

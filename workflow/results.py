import sys;print("stub")

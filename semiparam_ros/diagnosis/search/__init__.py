"""The stepwise search for effects: candidates, their scores, ambiguity, refits and elimination."""

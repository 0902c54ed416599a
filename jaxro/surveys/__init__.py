"""Heights over a grid of squares from parallaxes, and networks of levelling.

heights         formulas of single heights and differences (Gutkin 1982)
accuracy        closed forms of their accuracy, and exact budgets
planning        accuracy to expect of a survey; base and camera height it needs
networks        how legs form traverses between nodes
levelling       adjustment of a network of levelling
grid_survey     a whole survey, with errors in common
mock_surveys    surveys of a simulated surface
"""

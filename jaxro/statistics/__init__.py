"""Tests of the rows of any solution: which observations are wrong, and which errors
would be found.

    rows               whitened residuals and the design of a solution
    normalised         normalised residuals w and their correlations
    familywise         critical values of the largest |w| or |tau|
    explanations       rows that explain a misfit equally well
    identification     errors that are attributed to the right row
    groups             tests of several rows together
    promise            what verdicts and intervals are worth, by simulation
"""

"""Tracking: from pose hypotheses of single frames to the smoothed track of one animal.

Association by Viterbi (`association`), Kalman filter and RTS smoother (`smoother`), fixed-interval
(`offline`) and fixed-lag (`online`); the particle filter of Lie-X section 4.2 (`particles`).
"""

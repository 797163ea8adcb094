"""Every threshold of the diagnosis: what it decides, and where its value comes from.

All of them work out of the box; a test or a user changes one with ``diagnose(..., config=DiagnosisConfig(folds=5))``.
*Measured* values were set between what recordings with and without the thing in question gave; *chosen* ones are round
numbers that were not tuned. Numbers that only keep arithmetic finite stay beside the arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass

from semiparam_ros.core.signals.rests import LEAST_S, SPEED_SHARE


@dataclass(frozen=True)
class DiagnosisConfig:
    """The thresholds, room by room."""

    # --- what words mean ---

    most: float = 0.5
    """Calls more than this share most of a thing: of an output's variance that a model leaves, of that what is no
    noise, of what a model leaves that errors of accelerations make, of samples that are zero (by the word)."""
    little: float = 0.1
    """Calls less than this share little: what errors of accelerations make at the rate that is recommended, what the
    first effect leaves where somebody pushed an arm whose description is right, what touches hold of what is left of an
    output, and the integral of a velocity beside the change of its position (chosen)."""
    alike: float = 0.7
    """Calls two things alike beyond this cosine: outputs and prediction of which the ratio is a unit, what two effects
    explain that are rivals (chosen)."""
    negligible: float = 1e-6
    """Takes less than this share for nothing: a direction that is held by declared columns already, a combination of
    masses that no motion could show (chosen)."""
    most_samples: int = 4000
    """Looks at no more than so many samples, or spans of time, evenly spread: more say nothing new (chosen)."""
    rounds: int = 6
    """Fits two things in turn so often: a description and its noise, a model and where touches bend it (chosen)."""

    # --- what a recording must hold ---

    least_samples: int = 200
    """Refuses recordings with fewer samples: below, hardly any effect can be told from noise (chosen)."""

    # --- data: preparation ---

    working_rate_hz: float = 40.0
    """Averages faster recordings down to about this rate [Hz], and less where the motion is too fast for it
    (chosen)."""
    most_working_samples: int = 10_000
    """Reads longer recordings in stretches that hold so many working samples: four minutes at 40 Hz (chosen)."""
    smoothing_ends: int = 5
    """Leaves out so many working samples at either end of a smoothed recording: it sees them from one side."""
    least_working_samples: int = 50
    """Refuses recordings with fewer working samples in use: these cannot tell one cause from another (chosen)."""
    faster: tuple[int, ...] = (2, 4, 8)
    """Recommends one of so many times the rate (chosen)."""
    rest_speed_share: float = SPEED_SHARE
    """Calls a joint resting below this share of its highest speed: static friction then holds any effort (chosen)."""
    sliding_s: float = 0.05
    """Calls a joint sliding when it is not slow within this time [s]: the longest lead of a friction
    (chosen)."""
    rest_s: float = LEAST_S
    """Asks of a rest that it lasts so long [s]: a joint that turns back is faster before and after. Joints that stick
    where they turn back, for 0.07 s and more, bent friction and rotors beyond two deviations with 0.2 (measured)."""

    # --- data: splits, and whether an effect carries over ---

    split_blocks: int = 15
    """Cuts a recording into so many blocks to fit and to judge: long against the noise's memory (chosen)."""
    held_out_every: int = 3
    """Holds every so many-th block out for judging, so that two thirds fit (chosen)."""

    # --- data: outliers ---

    gap_steps: float = 5.0
    """Takes a step of more than this many median steps for a gap (chosen)."""
    gap_margin: int = 10
    """Leaves out so many samples on either side of a gap, as far as differentiation reaches (chosen)."""
    shock_deviations: float = 15.0
    """Takes a change beyond this many robust standard deviations of a channel's changes for a shock (chosen)."""
    shock_share: float = 0.5
    """Asks of a shock also this share of the channel's standard deviation, which rounding does not reach (chosen)."""
    shock_margin_s: float = 0.1
    """Leaves out so many seconds before and after a shock, while the arm rings (chosen)."""
    most_shock_share: float = 0.03
    """Keeps the jumps of a channel when they would cost more than this share of the recording: it jumps by nature (dry
    friction, a coarse converter). The shocks of a real UR3 cost its wrist 0.011 (measured)."""

    # --- data: what the motion can show ---

    still_range: float = 0.002
    """Says that a joint stood still when it moves less than this in all [rad, or m] (chosen)."""
    slow_range: float = 0.05
    """Says that a joint hardly moved when it moves less than this in all [rad, or m] (chosen)."""
    unseen_share: float = 5e-4
    """Calls a mass unseen when a change as large as itself moves the outputs by less than this share of their standard
    deviation: rich motions of iCub, UR3 and Franka show each by 1e-3 or more, a locked joint leaves 1e-5 (measured)."""

    # --- evaluation ---

    horizon: int = 25
    """Sums the relative squared error over so many samples, the horizon of the paper."""
    bootstrap_draws: int = 400
    """Draws so many resamplings for a confidence interval (chosen)."""
    bootstrap_block: int = 50
    """Resamples contiguous blocks of so many samples, because neighbours repeat each other (chosen)."""
    confidence_percentiles: tuple[float, float] = (2.5, 97.5)
    """Bounds the confidence interval, 95 % by custom."""

    # --- noise of a residual ---

    longest_correlation_share: float = 0.1
    """Follows an autocorrelation up to this share of the residual's length, beyond which it is chance (chosen)."""
    noise_order: int = 20
    """Draws coloured noise from an autoregression of this order: half a second at the working rate (chosen)."""
    resmoothing_windows: tuple[int, ...] = (9, 15)
    """Smooths the motion over so many samples, to see what noise in the inputs leaves in a residual: the share found on
    clean circles falls from 0.05 to 0.004, a real bump keeps 0.23 (measured)."""
    resmoothing_degree: int = 4
    """Fits a polynomial of this degree in these windows, which keeps the bends of arm motion (chosen)."""

    # --- setup: motion, units and clock ---

    setup_samples: int = 250
    """Compares so many samples, evenly spread, with the robot description under dozens of labels (chosen)."""
    span_s: float = 0.2
    """Compares a change with its integral over this time [s]: long against noise, short against motion (chosen)."""
    ratio_tolerance: float = 1.25
    """Takes a ratio within this factor of a known one for that one, and lets most spans agree on it within this factor:
    real iCub, UR3 and Franka give 0.92 to 1.02 of what is right (measured)."""
    own_correlation: float = 0.98
    """Calls no velocity swapped that follows its own position with this correlation: those of a real iCub, which its
    driver filters, do with 0.985 (measured)."""
    zero_leap: float = 0.3
    """Asks also that it leaps between zero and this share of its usual values: a coarse converter passes through the
    small ones (chosen)."""
    direction_share: float = 0.02
    """Counts a direction of the joints' motion that has this share of the largest one's size (chosen)."""

    # --- setup: outputs, orders, directions and mounting ---

    same_gravity_cosine: float = 0.9
    """Takes two directions of gravity for one beyond this cosine, 26 degrees (chosen)."""
    unit_tolerance: float = 2.0
    """Takes a ratio within this factor of a unit for it: a real UR3's efforts are 1.7 times the description's."""
    no_match_share: float = 0.4
    """Doubts the robot description when the best inertias leave this share of variance: the worst effect of size 3
    leaves 0.32, other arms' descriptions and sensor frames 0.43 to 1 (measured)."""
    most_relabellings: int = 2
    """Corrects so many wrong labels one after the other; a third would be another robot (chosen)."""

    # --- setup: misfit of the description ---

    model_error: float = 0.03
    """Lets a description be wrong by this share of an output's variance (chosen)."""
    inertia_deviation: float = 0.3
    """Allows an inertial parameter one standard deviation of this share of the body's own size (chosen)."""
    friction_turn_share: float = 0.05
    """Lets dry friction turn over within this share of a joint's highest speed (chosen)."""

    # --- score ---

    blocks: int = 24
    """Scores a model by so many blocks of the recording, each predicted from the others (chosen)."""
    coarseness: float = 1e4
    """Counts no more than so many independent outputs, however long the recording: a model is true to about a per cent
    of its noise, not to the last digit (chosen)."""
    sure: float = 2.5
    """Asks of a gain that it is so many times its standard error over the blocks: 1 in 160 by chance."""
    odds: float = 1e5
    """Takes a kind of effect for so unlikely that odds of it before the recording are one to this (chosen)."""
    tried: int = 8
    """Scores so many of the candidates of a round, the most credible first, and the foremost of each kind (chosen)."""
    of_each_kind: int = 3
    """Refines so many places of each kind with many values: with none a cable that slips was passed over, with one it
    came after another kind (measured)."""

    # --- search: rounds and candidates ---

    most_rounds: int = 20
    """Stops the search after so many rounds (chosen; it ends before by itself)."""
    refine_evaluations: int = 14
    """Spends so many evaluations on the line search of one value: its bracket then shrinks a thousandfold."""
    line_search_rounds: int = 4
    """Searches three values and more so many times in turn, for the best one depends on the others; in the second half
    of the rounds, the point of application too. Tries as many lengths of a Gauss-Newton step (chosen)."""
    start_grid: int = 60
    """Tries so many starts of an effect, evenly spread, before the best is refined (chosen)."""
    start_margin: float = 0.1
    """Tries no start within this share of either end: too little would be seen before or after it (chosen)."""
    longest_lever_m: float = 0.3
    """Shortens a step of a point of application to this length [m], about that of a link (chosen)."""
    newton_steps: int = 12
    """Settles calibrations, nonlinear values of effects, and a point of application in at most so many Gauss-Newton
    steps (chosen)."""
    backtracking: float = 0.25
    """Shortens a Gauss-Newton step that would raise the loss to this share (chosen)."""
    settled_gain: float = 0.1
    """Ends the Gauss-Newton steps of calibrations and nonlinear values once they gain less than this of the squares
    over their variance: less than a third of a standard deviation (chosen)."""

    weight_shows: float = 18.5
    """Refuses a load whose mass and first moments lie nearer to none than this squared distance, in their own
    covariance: 1 in 1000 by chance with four of them."""
    unlike_a_body: float = 4.0
    """Refuses a load of which an eigenvalue of the pseudo-inertia lies so many standard deviations below zero
    (chosen)."""

    # --- residual: is anything left? ---

    structure_least_samples: int = 300
    """Looks for structure only in this many samples: a flexible regression says nothing on fewer (chosen)."""
    structure_blocks: int = 60
    """Cuts the residual into so many short blocks, so that every fold sees the whole recording (chosen)."""
    structure_folds: int = 5
    """Deals these blocks out to so many folds (chosen)."""
    structure_share: float = 0.015
    """Calls structure significant from this share of the residual on, all channels together (measured: clean recordings
    keep at most 0.004)."""
    channel_share: float = 0.05
    """Calls structure in one channel alone significant from this share of its residual on, and shows a formula that
    explains as much of it on unseen blocks (chosen)."""
    chance_draws: int = 16
    """Compares with so many draws of noise of the residual's colour (chosen)."""
    beyond_chance: float = 4.0
    """Asks that the share exceeds that of such noise by this many of its standard deviations: noise correlated over
    0.2 to 4 s exceeds it by up to 2.0, and in one channel by up to 3.5 (measured)."""
    penalty_exponents: tuple[float, ...] = tuple(half / 2.0 for half in range(-6, 9))
    """Offers each channel 10 to these powers as variance of the noise over that of the function (chosen)."""
    motion_features: int = 240
    """Draws so many random features of the whole motion at each length scale (chosen)."""
    motion_scales: tuple[float, ...] = (1.0, 3.0)
    """Gives the features these length scales, over the square root of the number of inputs (chosen)."""
    waves: int = 12
    """Describes what changes with time by so many waves: the fastest lasts a tenth of the recording (chosen)."""
    slow_waves: int = 3
    """Describes a coefficient that changes slowly by so many waves (chosen)."""
    bells: int = 9
    """Describes a function of one variable by so many bells across its range (chosen)."""

    # --- residual: what it depends on ---

    most_variables: int = 4
    """Names at most so many variables: a reader cannot do with more (chosen)."""
    variable_share: float = 0.05
    """Adds a variable that adds this share of what all of them predict, and prefers position to velocity to
    acceleration by this share each, since noise spoils derivatives (chosen)."""
    pair_worth: float = 1.5
    """Takes a pair that predicts this many times what any single variable does (chosen)."""

    # --- residual: a formula ---

    most_terms: int = 6
    """Gives a formula at most so many terms: a reader cannot do with more (chosen)."""
    formula_enough: float = 0.9
    """Takes the shortest formula that explains this share of what the best one explains (chosen)."""
    declared_share: float = 0.25
    """Offers a formula as an effect when it explains this share of a channel's residual on unseen blocks (chosen)."""
    bump_quantiles: tuple[float, ...] = (0.02, 0.15, 0.3, 0.5, 0.7, 0.85, 0.98)
    """Places bumps at these quantiles of a position, from end to end (chosen)."""
    bump_widths: tuple[float, ...] = (0.25, 0.6)
    """Makes bumps this wide, in standard deviations of the position (chosen)."""

    # --- several recordings and rivals ---

    better_odds: float = 20.0
    """Prefers what the description leaves open up to these odds against it, of as many values, and names a rival passed
    over for another as the better one above them: strong evidence (Kass and Raftery 1995)."""

    # --- residual: contacts ---

    contact_deviations: float = 12.0
    """Calls a burst of the residual a contact when it reaches this many robust standard deviations (chosen)."""
    contact_release: float = 5.0
    """Lets it last, and a channel take part, above this many of them (chosen)."""
    contact_samples: int = 3
    """Asks for that many neighbouring working samples at once: a reversal of friction is shorter (chosen)."""
    contact_pause_s: float = 0.4
    """Takes bursts with shorter pauses for one contact (chosen)."""
    longest_contact_s: float = 10.0
    """Calls nothing longer a contact: a load or a force is an effect (chosen)."""
    most_contact_share: float = 0.4
    """Names no contacts when more than this share of the samples bursts (chosen)."""

    # --- changes while the robot works ---

    change_before_s: float = 8.0
    """Searches the time of a change so long before it seemed to begin: what notices it looks back no longer."""
    change_after_s: float = 2.0
    """Searches it so long after (chosen)."""


DEFAULTS = DiagnosisConfig()
"""The values that every figure in the documentation was measured with."""

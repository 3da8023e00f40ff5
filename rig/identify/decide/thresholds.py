"""Holds every threshold of the decision of `explain`: value, unit, reason, and what it was set on.

"Chosen" means that no theory gives the number: it was set by hand, and the rates of right and wrong
answers in docs/explain_rates.md show its effect. "First", "second" and "third" are the three
generators of braking stops in tests/generator. The first and the second set thresholds. The third
only judges them.

A likelihood ratio is a drop of -2 ln L in this file. What differs from cause to cause is in the
rows of `causes/table`: the numerical floor, the price of the shape, and a limit of the p-value
where a cause needs a limit other than `ALPHA_CAUSE`.
"""

from rollerrig.rig.identify.causes import table

# --- replay and base ---

# Accepted range of the variance of the normalised innovations of the fitted base (1 is right).
# Outside it the declared accuracy of the dataset is wrong. Chosen.
LEAST_INNOVATION_VARIANCE = 0.3
MOST_INNOVATION_VARIANCE = 2.5

# Largest mean square of the normalised innovations of a wheelset or a vehicle in a run with which a
# base may be called consistent. It is at most 1.08 on eight clean sets of three generators. Chosen.
MOST_MEAN_SQUARE = 1.6

# Longest irregularity of the rail in m. A longer change of friction is not noise and must be
# explained: a free length absorbed cleaning, sand and patches.
LONGEST_IRREGULARITY_M = 16.0

# Standard deviation in N m of the torque of a released brake. An offset beyond it shows before the
# brake applies. Chosen.
RELEASED_TORQUE_NM = 30.0

# Innovations beyond this number of standard deviations count as outliers: their squares are
# bounded.
OUTLIER_DEVIATIONS = 6.0

# --- null simulations: simulated stops with no further cause in them ---

# Most null simulations of the base. The spread of each estimate is then known to a tenth.
MOST_NULL_SIMULATIONS = 60

# Most null simulations with a cause in the model. Fewer, since they judge only the remainder.
MOST_NULL_SIMULATIONS_WITH_CAUSE = 40

# Null simulations that run before the search checks whether more would change the decision. The
# p-values take the number into account (F distribution).
NULL_SIMULATIONS_PER_ROUND = 20

# Mean square of the normalised innovations of a null simulation above which it is discarded: a
# wheel locked that did not lock in the recording. The data are refused if more than half are
# discarded.
RUNAWAY_VARIANCE = 1.2

# A score test whose statistic is above this multiple of SCORE_FLOOR needs no more null simulations:
# 20 of them give the spread to 16 %.
CLEAR_FACTOR = 4.0

# A score test is near its limit if its p-value is below this multiple of its limit and its
# statistic is above this share of SCORE_FLOOR. No more null simulations are needed if no test is
# near its limit. Chosen.
NEAR_FACTOR = 10.0
NEAR_SHARE = 0.5

# A clear cause must exceed the windows near their limits by this factor. Chosen.
CLEAR_OF_WINDOWS = 2.0

# --- score tests ---

# Largest p-value of a cause: one false alarm in 2 % of data sets, shared among about 30 causes and
# axles.
ALPHA_CAUSE = table.ALPHA_CAUSE

# Number of causes and axles among which the false alarms are shared.
CAUSES_SEARCHED = 30

# Largest p-value of a smooth function of the remainder: 0.5 %, shared among 13 functions. The size
# of an identified cause by run and by time is judged by it too.
ALPHA_SMOOTH_FUNCTION = 0.005 / 13.0

# Statistic, less the number of coefficients, that a score test must reach besides its p-value: the
# null simulations do not show the tail of the distribution. Chosen.
SCORE_FLOOR = 12.0

# Least spread of an estimate over null simulations, as a share of its nominal variance. Chosen.
LEAST_SCALE = 0.7

# Longest patch of the search, in bins of place: 250 m.
MOST_PATCH_BINS = 10

# Longest application of sand of the search, in bins of time: 12 s.
MOST_SAND_BINS = 6

# Least width of the Gumbel distribution of the largest window: a share of its mean over the null
# simulations, plus an offset. Chosen.
LEAST_GUMBEL_SHARE = 0.15
LEAST_GUMBEL_WIDTH = 0.3

# Mean of the largest window's statistic over null simulations for which the nominal error of its
# coefficient is right; a larger mean widens the error. Chosen for a patch, and for sand in one run.
ORDINARY_PATCH_STATISTIC = 8.0
ORDINARY_SAND_STATISTIC = 6.0

# A run has sand where its statistic is above this share of the mean of the runs. Chosen.
SAND_SHARE_OF_RUN = 0.5

# --- most promising causes, before null simulations have judged them ---

# Causes that are fitted together with the base, to find the irregularity of the rail without them.
MOST_PROMISING = 4

# Least statistic of a promising cause, and its cost per coefficient. For a window both are larger,
# because it is the best of many windows. Chosen.
PROMISING_FLOOR = 10.0
PROMISING_COST = 3.0
PROMISING_WINDOW_FLOOR = 50.0
PROMISING_WINDOW_COST = 40.0

# --- choice of causes ---

# Most causes that are fitted in full, those of the largest statistic. Limits the time.
MOST_FITTED = 5

# Least likelihood ratio of a cause, less the price of its shape. Chosen.
LEAST_RATIO = 20.0

# Likelihood ratio that each further coefficient of a shape must earn, besides 2 ln of the number of
# shapes and axles tried. Chosen.
PRICE_OF_COEFFICIENT = 5.0

# Share of the evidence that must lie outside its best block: a cause is no single event. Patches
# and sand are events, and are exempt. Chosen.
SHARE_OUTSIDE_BEST_BLOCK = 0.2

# Length in s of the blocks of Vuong's test and of the bootstrap: longer than the memory of the
# filter.
BLOCK_S = 3.0

# Largest bias of a smooth function of friction in null simulations of counted pulses, in the
# logarithm of friction. Chosen: on sets of the second generator it is 0.8 to 1.1 along the
# deceleration, up to 1.2 along the energy, and at most 0.4 along other quantities of all wheels.
LARGEST_NULL_BIAS = 0.5

# Likelihood ratio that no null simulation can win: a cause whose fit wins it needs no score,
# because scores are not reliable far from the base. Chosen.
CERTAIN_RATIO = 300.0

# A fit from another start replaces a fit of the same cause only if it is better by this ratio.
BETTER_FIT_RATIO = 4.0

# A rival is distinguishable without a test if it wins less than this share of the best ratio, and
# the difference is above this value.
CLEARLY_LESS_SHARE = 0.75
CLEARLY_LESS_RATIO = 10.0

# Other rivals are distinguishable by Vuong's test: if the difference is at least this number of its
# standard deviations (one-sided 5 %), and at least this value. Chosen.
VUONG_DEVIATIONS = 1.64
VUONG_LEAST_RATIO = 4.0

# --- second cause ---

# Most identified causes. Few stops distinguish more; a third one is reported in a note.
MOST_CAUSES = 2

# Most second causes that are fitted.
MOST_FITTED_SECOND = 3

# A second cause is also fitted in other shapes whose statistic is at least this share of the best
# one's: scores rank shapes wrongly where the base has absorbed a part of the effect. Chosen.
NEAR_SHAPE_SHARE = 0.5

# Share of the first cause's ratio in a filter that the wrong shape of the first cause can lend to a
# second cause there. Chosen.
LENT_SHARE = 0.11

# The same for a second cause on one axle if the first cause acts on all axles: a wrong shape of
# such a cause can hardly look like a cause on one axle. Chosen.
LENT_SHARE_TO_ONE_AXLE = 0.05

# Least ratio of a second cause beyond what the first cause can lend; as for the first.
LEAST_RATIO_OF_SECOND = 20.0

# The statistic of a second cause, before its fit, may be this share of its ratio after the fit.
# Chosen.
SCORE_SHARE_OF_RATIO = 0.3

# A second cause that is confusable with the first one must win this share of the first one's ratio.
# Chosen.
CONFUSABLE_SECOND_SHARE = 0.3

# Least size of sand as a second cause: the middle between 0.025, the false sand beside a torque
# offset in set 292 of the first generator, and 0.050, the smallest true sand in its 12 sets that
# hide sand. Weaker sand is not identified beside another cause.
LEAST_SAND_AS_SECOND = 0.04

# --- coherence: a cause shows the same everywhere ---

# Sand begins in all runs within so many seconds of each other after the brake acts or after the
# first slide, or within so many m/s of the same speed. Chosen: sand of the three generators begins
# 3 to 9 s after the stop begins.
SAND_ONSET_TOLERANCE_S = 6.5
SAND_ONSET_TOLERANCE_M_S = 2.0

# Sliding in m/s that may trigger sand, and s by which the edge of a window may be too early: half
# a bin.
SAND_SLIDE_M_S = 1.0
SAND_EDGE_S = 1.0

# Longest over shortest time for which sand acts in the runs. Chosen: at most 2.4 in sets of the
# first and second generator with sand.
SAND_DURATION_RATIO = 2.7

# Share of what a patch won that edges moved in each run alone may win. Chosen: patches of the three
# generators give 0.01 to 0.05.
PATCH_APART_SHARE = 0.07

# Square of the difference in standard deviations between a torque in the filters of the wheels and
# in that of the vehicle: 0 to 16 for torques of the three generators. Chosen.
MOST_DISAGREEMENT = 25.0

# The same difference as a share of the larger of both: the deviations do not contain a wrong law of
# adhesion, which may bias a torque in the wheels: at most 0.44 for these torques, 0.94 for a glazed
# tread. Chosen.
OTHER_FORCE_SHARE = 0.7

# Least difference between the mean loads of two runs, as a share, at which causes that differ only
# in how they depend on load may be distinguished. Chosen.
LEAST_LOAD_DIFFERENCE = 0.1

# --- shapes ---

# Share of the base's irregularity with which windows are searched first: what they explain has
# roughened the base. Set on three sealed rigs with sand.
SMOOTHER_RAIL_SHARE = 0.3

# Likelihood ratio that other edges of a patch, or an effect on the clean rail too, must earn.
# Chosen.
RATIO_OF_OTHER_WINDOW = 4.0

# Likelihood ratio that each move of a scale must earn. Chosen.
RATIO_OF_SCALE_MOVE = 1.0

# --- materiality ---

# A cause that changes the torque, or a remaining force on the vehicle, by up to this number of
# declared standard deviations of the calibration is no error of the model. Chosen: two deviations
# are what a declared accuracy means.
IMMATERIAL_DEVIATIONS = 2.0

# Steps of the fit of brakes that vary in common: the change is small, so few are enough. Chosen.
STEPS_OF_COMMON_BRAKE = 5

# --- remainder, and the verdict ---

# Statistic, less the number of coefficients, above which a remainder counts; as LEAST_RATIO.
CLEAR_REMAINDER = 20.0

# A remainder above this share of the causes' likelihood ratio is more than their shape explains:
# the verdict is `partly` or `unexplained`. Set by the first and the second generator (table in
# docs/explain_rates.md).
REMAINDER_SHARE = 0.08

# The same for a remainder along a covariate that the cause itself depends on, since its shape may
# differ there. Only if one cause is identified. Set by the first and the second generator.
OWN_REMAINDER_SHARE = 0.2

# The same for a remainder along the angle of the wheel behind a cause that swings once a turn: no
# out-of-round wheel of the first and the second generator leaves any. With more no cause is
# reported.
SWING_REMAINDER_SHARE = 0.02

# Largest remainder, as a share of all evidence, with which a cause is still reported (`partly`).
# Set by the first and the second generator. Two causes that leave a remainder above REMAINDER_SHARE
# are never reported: on the first generator only an effect outside the library left that much.
PARTLY_SHARE = 0.15

# --- gain on runs that were never fitted ---

# Time in s over which the speed of the vehicle is predicted. Shorter is noise, longer is more than
# a slide.
FREE_RUN_S = 5.0

# Least speed in m/s of the samples that count: creepage grows without bound as the speed falls to
# 0.
SLOWEST_M_S = 5.0

# Likelihood ratio on runs that were never fitted with which a gain is claimed: less comes by chance
# in 5 % of datasets (chi-squared, one coefficient).
LEAST_LIKELIHOOD_OF_GAIN = 3.84

# --- empirical formula ---

# Covariates that are tried, those of the largest remainder.
MOST_COVARIATES_TRIED = 3

# Likelihood ratio that a formula must win, as a cause.
LEAST_RATIO_OF_FORMULA = 20.0

"""Every threshold by which a recording is judged, with its unit, its reason and what it was set on.

The table in docs/recorders.md repeats values and reasons; a test compares the two. Values are set
by hand from what the channels can do. "Twins" are simulated recordings of runs of the bench.
"""

# --- stamps and sensors ---

# s. Samples further apart are a gap. Shorter intervals are lost messages.
GAP_S = 1.0

# s. A smaller irregularity of the stamps is a late message.
LEAST_STEP_S = 0.3

# standard errors. Speed or position must contradict a gap by this much to make it a clock step.
# Chosen.
CLOCK_RATIO = 4.0

# s. Old messages are searched for in this time after the start. In recordings of trams they lasted
# 2 to 6 s.
START_S = 15.0

# m/s^2. No vehicle brakes or starts harder. Emergency brakes of trams with track brakes reach 2.7.
HARDEST_M_S2 = 3.0

# m/s^2. What a vehicle may gain while its wheels slide in braking: 30 per mille downhill. Set on
# twins.
DRIVES_M_S2 = 0.3

# m/s. A larger change between two samples, beyond the hardest braking, cannot be vehicle motion.
# Noise and rounding stay below.
JUMP_M_S = 1.0

# m/s. A wheel does not lock, or take up speed again, by this much between two samples.
ZERO_JUMP_M_S = 2.0

# s. A value that is held for longer, while the other channels move, is stuck.
STUCK_S = 1.0

# m/s. The other channels must move by this much while a value is held. That is many rounding steps.
MOVED_M_S = 1.0

# s. Shorter straight stretches occur by chance.
LINE_S = 2.0

# share of the channel's usual roughness. A stretch below it is drawn, not measured. Chosen.
LINE_SHARE = 0.05

# samples. Length of the equal stretches that are searched for.
COPY_SAMPLES = 50

# samples out of COPY_SAMPLES that must differ from the previous one. Standing still repeats, moving
# does not.
COPY_CHANGES = 20

# share. A ratio this close to the ratio of two units is a wrong unit. The nearest two ratios differ
# by 0.28.
UNIT_SHARE = 0.06

# --- comparison of channels ---

# s. Means over blocks of this length count as independent. Receiver noise and slides are shorter.
BLOCK_S = 5.0

# m/s^2. Braking below it makes less than 0.1 % of creepage on a dry rail.
QUIET_M_S2 = 0.5

# m/s. Below it rounding weighs too much.
SLOWEST_M_S = 4.0

# probability of a false alarm in a fault-free recording, shared among channels and dates.
ALPHA = 0.02

# blocks. Fewer do not show their scatter.
LEAST_BLOCKS = 6

# share of the radius beyond its error. Wear within a setting, creepage, receiver and rounding stay
# below.
LEAST_RADIUS = 0.002

# s. One and a half samples at 10 Hz. Creepage in braking looks like 0.04 s.
LATE_S = 0.15

# s. Longest delay that is searched for.
LATEST_S = 3.0

# m/s. A slide counts no more than this against a delay.
CAP_M_S = 1.0

# --- slides ---

# m/s. Many times noise and rounding.
SLIDE_M_S = 0.4

# share of the vehicle speed. Beyond the creepage at the peak of adhesion.
SLIDE_SHARE = 0.03

# multiples of the channel's scatter.
SLIDE_DEVIATIONS = 5.0

# s. Shorter is noise. Raised from 0.3 on twins: a burst of noise looked like a slide.
SLIDE_S = 0.5

# m/s. Without a reference, wheels roll where their speeds stay closer than this for 2 s. Set on
# twins.
TOGETHER_M_S = 0.4

# m/s^2. Running resistance of a coach at 40 m/s, subtracted from the adhesion bound.
RESISTANCE_M_S2 = 0.05

# probability that slides anywhere on the braked track would meet as often.
PLACE_P = 0.01

# runs. Fewer do not make a shared place.
PLACE_RUNS = 3

# --- what is left ---

# m/s. Offset of a block of BLOCK_S that is reported as unknown. Chosen.
LEFT_M_S = 0.15

# share of the speed, for the same offset. Creepage of driving stays below.
LEFT_SHARE = 0.01

# standard errors of the block's mean that the same offset must exceed.
LEFT_DEVIATIONS = 6.0

# multiples of the channel's usual scatter. A block above it is reported as unknown. Chosen.
ROUGH = 3.0

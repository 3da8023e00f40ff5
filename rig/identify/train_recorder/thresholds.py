"""Every threshold by which a recording is judged. Reasons, and what they were set on: docs/recorders.md."""

# stamps and sensors
GAP_S = 1.0  # samples further apart are a gap
LEAST_STEP_S = 0.3  # a smaller irregularity of stamps is a late message
CLOCK_RATIO = (
    4.0  # deviations by which speed or position must contradict a gap to make it a clock step
)
START_S = 15.0  # old messages are looked for so long
HARDEST_M_S2 = 3.0  # no vehicle brakes or starts harder
DRIVES_M_S2 = 0.3  # so much a vehicle may gain (downhill) while its wheels slide in braking
JUMP_M_S = 1.0  # beyond it and the hardest braking a change within a sample is none of the vehicle
ZERO_JUMP_M_S = 2.0  # a wheel does not lock, or take up speed, by so much within a sample
STUCK_S = 1.0
MOVED_M_S = 1.0  # change of the other channels that makes a held value a stuck one
LINE_S = 2.0
LINE_SHARE = 0.05  # of the channel's usual roughness, below which a stretch is a drawn line
COPY_SAMPLES = 50
COPY_CHANGES = 20  # of these that differ from the one before: a stop repeats, its noise does not
UNIT_SHARE = 0.06  # a ratio so close to that of two units is an error of unit
# comparison of channels
BLOCK_S = 5.0  # means of such blocks are taken as independent
QUIET_M_S2 = 0.5  # braking below it makes less than 0.1 % of creepage
SLOWEST_M_S = 4.0
ALPHA = 0.02  # false alarms of a clean set, shared among channels and dates
LEAST_BLOCKS = 6
LEAST_RADIUS = 0.002  # share; wear within a setting, creepage and rounding stay below
LATE_S = 0.15
LATEST_S = 3.0  # longest delay that is looked for
CAP_M_S = 1.0  # a slide counts no more than this against a delay
# slides
SLIDE_M_S = 0.4
SLIDE_SHARE = 0.03
SLIDE_DEVIATIONS = 5.0
SLIDE_S = 0.5
TOGETHER_M_S = 0.4  # speeds closer than this for two seconds roll, where no reference tells it
RESISTANCE_M_S2 = 0.05  # of the vehicle's running, taken off the adhesion bound
PLACE_P = 0.01
PLACE_RUNS = 3
# what is left
LEFT_M_S = 0.15
LEFT_SHARE = 0.01
LEFT_DEVIATIONS = 6.0
ROUGH = 3.0  # scatter of a block over the channel's own

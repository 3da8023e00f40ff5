"""The runs of a short campaign without a process of workers, which would load everything again."""

from rollerrig.realtime.campaign import campaign


def run_here(path, out):
    """Do all runs of a plan in this process; the command line finds them done."""
    plan = campaign.load(str(path))
    for chunk in campaign.open_result(plan, out):
        campaign.write_chunk(out, chunk, campaign.run_chunk(plan, chunk))

"""Which plan a campaign's rule asks for."""

from testbench.campaign.combinations import CombinationPlan
from testbench.campaign.critical import CriticalPlan
from testbench.campaign.plans import GridPlan, SequentialPlan
from testbench.campaign.records import Plan
from testbench.campaign.rules import FixedRuns, Until
from testbench.campaign.schema import Campaign
from testbench.campaign.search import CriticalSearch


def plan_of(campaign: Campaign) -> Plan:
    """The plan, which has seen nothing yet."""
    rule = campaign.rule
    if isinstance(rule, FixedRuns):
        return GridPlan(campaign.points, rule)
    if isinstance(rule, Until):
        return SequentialPlan(campaign.points, rule)
    if isinstance(rule, CriticalSearch):
        return CriticalPlan(rule, campaign.points, [axis.name for axis in campaign.axes].index(rule.axis))
    return CombinationPlan(rule, campaign.points)

"""Which plan a campaign's rule asks for."""

from testbench.campaign.file.rules import FixedRuns, Until
from testbench.campaign.file.schema import Campaign
from testbench.campaign.plans.combinations import CombinationPlan
from testbench.campaign.plans.critical import CriticalPlan
from testbench.campaign.plans.grid import GridPlan, SequentialPlan
from testbench.campaign.plans.search import CriticalSearch
from testbench.campaign.records import Plan


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

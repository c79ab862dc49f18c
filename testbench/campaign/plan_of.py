"""Which plan a campaign's rule asks for."""

from testbench.campaign.plans import GridPlan, SequentialPlan
from testbench.campaign.records import Plan
from testbench.campaign.rules import FixedRuns, Until
from testbench.campaign.schema import Campaign
from testbench.errors import BenchError


def plan_of(campaign: Campaign) -> Plan:
    """The plan; raises BenchError for a rule there is no plan for."""
    rule = campaign.rule
    if isinstance(rule, FixedRuns):
        return GridPlan(campaign.points, rule)
    if isinstance(rule, Until):
        return SequentialPlan(campaign.points, rule)
    raise BenchError(f"campaign {campaign.name}: search is not available yet; available: runs")

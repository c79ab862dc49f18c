"""Which plan a campaign's rule asks for."""

from testbench.campaign.plans import GridPlan, SequentialPlan
from testbench.campaign.records import Plan
from testbench.campaign.rules import FixedRuns, Until
from testbench.campaign.schema import Campaign
from testbench.errors import BenchError


def plan_of(campaign: Campaign) -> Plan:
    """The plan; raises BenchError for a rule there is no plan for."""
    match campaign.rule:
        case FixedRuns():
            return GridPlan(campaign.points, campaign.rule)
        case Until():
            return SequentialPlan(campaign.points, campaign.rule)
    raise BenchError(f"campaign {campaign.name}: search is not available yet; available: runs")

import pytest
from saved_models import models


@pytest.fixture(scope="session")
def fitted():
    """Return by name a model of every kind, and inputs that it was made for (N, n)."""
    return models()

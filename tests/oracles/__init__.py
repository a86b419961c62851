"""An independent reference for the layer's problem: it shares no code with torch_dpc, only the problem as posed."""

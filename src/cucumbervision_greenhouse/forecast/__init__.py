"""From lengths to decisions: growth, forecast, picking and labour."""

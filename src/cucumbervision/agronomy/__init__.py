"""From lengths to decisions: crop profiles, grades, growth, forecast, picking and labour."""

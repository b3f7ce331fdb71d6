"""albedo"""

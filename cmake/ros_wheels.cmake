# The ROS wheels from PyPI export CMake targets that name include folders of the machine they were
# built on (/opt/python/cp3xx), which CMake rejects. Take those folders out of every imported target
# once the project is configured; installed files stay as they are. Without the wheels this does nothing.
#
# Passed as CMAKE_PROJECT_INCLUDE, or as CMAKE_TOOLCHAIN_FILE, which plain `colcon build` honours.

if(CMAKE_VERSION VERSION_LESS 3.21)
  message(FATAL_ERROR "the ROS wheels need CMake 3.21 or later; this is ${CMAKE_VERSION}")
endif()

if(NOT COMMAND _uwb_drop_wheel_includes)
  function(_uwb_drop_wheel_includes)
    get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
    foreach(target IN LISTS targets)
      get_target_property(folders "${target}" INTERFACE_INCLUDE_DIRECTORIES)
      if(folders)
        list(FILTER folders EXCLUDE REGEX "^/opt/python/")
        set_target_properties("${target}" PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${folders}")
      endif()
    endforeach()
  endfunction()
  cmake_language(DEFER DIRECTORY "${CMAKE_SOURCE_DIR}" CALL _uwb_drop_wheel_includes)
endif()

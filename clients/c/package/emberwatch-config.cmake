# find_package(emberwatch), then target_link_libraries(mine emberwatch::emberwatch); or emberwatch::static, which makes a
# program that needs no libemberwatch.so.
get_filename_component(emberwatch_prefix "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
if(NOT TARGET emberwatch::emberwatch)
    add_library(emberwatch::emberwatch SHARED IMPORTED)
    set_target_properties(emberwatch::emberwatch PROPERTIES
        IMPORTED_LOCATION "${emberwatch_prefix}/lib/libemberwatch.so"
        IMPORTED_SONAME libemberwatch.so.1
        INTERFACE_INCLUDE_DIRECTORIES "${emberwatch_prefix}/include")
    add_library(emberwatch::static STATIC IMPORTED)
    set_target_properties(emberwatch::static PROPERTIES
        IMPORTED_LOCATION "${emberwatch_prefix}/lib/libemberwatch.a"
        INTERFACE_INCLUDE_DIRECTORIES "${emberwatch_prefix}/include"
        INTERFACE_LINK_LIBRARIES "pthread;dl;m")
endif()

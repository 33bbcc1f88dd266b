# What the builds of llama.cpp and HiGHS leave out here, and how their sources are grouped. One by one, the sources compile the same headers
# over and over. config.toml names this file as a toolchain, which is what both builds read; it names itself to be read again at the end
# of each project() call, where there is a project to change.
set(CMAKE_PROJECT_INCLUDE "${CMAKE_CURRENT_LIST_FILE}")
if(PROJECT_NAME STREQUAL "llama.cpp")
    # The binding crate asks for the common library, which nothing in Roomcast links.
    set(LLAMA_BUILD_COMMON OFF CACHE BOOL "not linked by Roomcast" FORCE)
    cmake_language(DEFER CALL set_target_properties llama PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 24)
elseif(PROJECT_NAME STREQUAL "HIGHS")
    # The laboratory alone solves with it.
    set(CMAKE_CXX_FLAGS_RELEASE "-O1 -DNDEBUG")
    cmake_language(DEFER CALL set_target_properties highs PROPERTIES
        UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 16 UNITY_BUILD_UNIQUE_ID HIGHS_UNITY_ID)
elseif(PROJECT_NAME STREQUAL "ggml" AND CMAKE_SYSTEM_PROCESSOR STREQUAL "aarch64" AND CMAKE_CXX_COMPILER_VERSION VERSION_LESS 14)
    # Debian 12's compiler knows no SME, which llama.cpp's kernels do not need for these processors.
    cmake_language(DEFER CALL set_target_properties ggml-cpu-armv9.2_1 PROPERTIES
        COMPILE_OPTIONS "-march=armv8.6-a+dotprod+fp16+sve+i8mm")
    cmake_language(DEFER CALL set_target_properties ggml-cpu-armv9.2_2 PROPERTIES
        COMPILE_OPTIONS "-march=armv8.6-a+dotprod+fp16+sve+i8mm+sve2")
endif()

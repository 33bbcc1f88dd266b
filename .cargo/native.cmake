# What the builds of llama.cpp and HiGHS leave out here, and how their sources are grouped. One by one, the sources compile the same headers
# over and over. config.toml names this file as a toolchain, which is what both builds read; it names itself to be read again at the end
# of each project() call, where there is a project to change.
set(CMAKE_PROJECT_INCLUDE "${CMAKE_CURRENT_LIST_FILE}")
# A library would keep the length of its build folder's name: two builds in different folders would differ.
set(CMAKE_SKIP_RPATH ON)
if(PROJECT_NAME STREQUAL "llama.cpp")
    # The binding crate asks for the common library, which nothing in Roomcast links.
    set(LLAMA_BUILD_COMMON OFF CACHE BOOL "not linked by Roomcast" FORCE)
    # Each of a hundred kinds of models has its own source. They are cold: a decoding runs through the sources below and through ggml.
    cmake_language(DEFER CALL target_compile_options llama PRIVATE -Os)
    set(hot batch context graph kv-cache vocab)
    list(TRANSFORM hot REPLACE "(.+)" "${CMAKE_CURRENT_SOURCE_DIR}/src/llama-\\1.cpp")
    cmake_language(DEFER CALL set_source_files_properties ${hot} TARGET_DIRECTORY llama PROPERTIES COMPILE_OPTIONS -O2)
    cmake_language(DEFER CALL set_target_properties llama PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 24)
elseif(PROJECT_NAME STREQUAL "HIGHS")
    # The laboratory alone solves with it.
    set(CMAKE_CXX_FLAGS_RELEASE "-O1 -DNDEBUG")
    cmake_language(DEFER CALL set_target_properties highs PROPERTIES
        UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 16 UNITY_BUILD_UNIQUE_ID HIGHS_UNITY_ID)
elseif(PROJECT_NAME STREQUAL "ggml" AND GGML_CPU_ALL_VARIANTS)
    # Packages leave out the kernels of processors that are rare or too old for the program, and of Arm with SME, which Debian 12's compiler does
    # not know. These processors use the next lower kernels. Each library needs a source; `.ci/deb` drops the empty ones.
    if(CMAKE_SYSTEM_PROCESSOR STREQUAL "aarch64")
        cmake_language(DEFER CALL set_target_properties ggml-cpu-armv8.2_1 ggml-cpu-armv9.2_1 ggml-cpu-armv9.2_2 PROPERTIES
            SOURCES "${CMAKE_CURRENT_SOURCE_DIR}/src/ggml-cpu/hbm.cpp" COMPILE_OPTIONS "")
    else()
        cmake_language(DEFER CALL set_target_properties ggml-cpu-x64 ggml-cpu-ivybridge ggml-cpu-piledriver ggml-cpu-cannonlake ggml-cpu-cooperlake
            PROPERTIES SOURCES "${CMAKE_CURRENT_SOURCE_DIR}/src/ggml-cpu/hbm.cpp")
    endif()
endif()
